"""Folders of images, 8- or 16-bit thermal or RGB, prepared alike for whatever describes them."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Shaped, UInt8

from taojax.errors import MissingExtraError
from taojax.specs import fail, read_bytes

__all__ = ["Preparation", "eight_bit", "kind_of_image", "list_images", "read_image"]

ENDINGS = (".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".pgm", ".webp")

COMMAND = "python -m pip install 'taojax[images]'"


@dataclasses.dataclass(frozen=True)
class Preparation:
    """How an image of one channel becomes 8 bits; colour stays as it is."""

    low_percent: float = 1.0
    """This percentile of each image becomes 0."""

    high_percent: float = 99.0
    """This one becomes 255: thermal counts fill a small part of their range."""

    clahe_clip: float = 2.0
    """Clip limit of the contrast-limited histogram equalisation; 0 leaves it away."""

    clahe_tiles: int = 8
    """Tiles across and down."""


def list_images(folder: Path) -> tuple[list[Path], str]:
    """List the images below a folder in the order in which they were taken.

    Args:
        folder: hidden files and other endings are passed over.

    Returns:
        Paths, and what orders them: names, or the numbers that they are.

    Raises:
        InputError: no folder, or fewer than three images.
    """
    if not folder.is_dir():
        raise fail(folder, "is no folder of images", "point at one")
    found = [
        path for path in folder.rglob("*")
        if path.suffix.lower() in ENDINGS and not path.name.startswith(".")
    ]  # fmt: skip
    if len(found) < 3:
        raise fail(folder, f"holds {len(found)} images", f"at least 3 of {', '.join(ENDINGS)}")
    names = {path: path.relative_to(folder).as_posix() for path in found}
    is_number = all(path.stem.isascii() and path.stem.isdigit() for path in found)
    if is_number and len({path.parent for path in found}) == 1:
        return sorted(found, key=lambda path: (int(path.stem), path.name)), "numbers"
    return sorted(found, key=names.__getitem__), "names"


def read_image(path: Path) -> Shaped[np.ndarray, "h w *c"]:
    """Read an image as it was stored.

    Returns:
        (H, W) of one channel, also where three channels are alike, or (H, W, 3) RGB; uint8 or
        uint16.

    Raises:
        InputError: no image, or numbers of another kind.
        MissingExtraError: OpenCV is not installed.
    """
    try:
        import cv2
    except ImportError as error:
        raise MissingExtraError(f"images need OpenCV; run: {COMMAND}") from error
    raw = np.frombuffer(read_bytes(path), np.uint8)
    image = cv2.imdecode(raw, cv2.IMREAD_UNCHANGED) if raw.size else None
    if image is None:
        raise fail(path, "is not a readable image", "save it again, or remove it")
    if image.dtype not in (np.uint8, np.uint16):
        raise fail(path, f"has pixels of {image.dtype}", "save it with 8 or 16 bits")
    if image.ndim == 2:
        return image
    if image.shape[2] not in (3, 4):
        raise fail(path, f"has {image.shape[2]} channels", "save it as gray or RGB")
    image = image[:, :, :3]
    if (image == image[:, :, :1]).all():
        return np.ascontiguousarray(image[:, :, 0])
    return np.ascontiguousarray(image[:, :, ::-1])


def kind_of_image(image: np.ndarray) -> str:
    """Name what an image is, such as 16-bit thermal or gray."""
    bits = 8 * image.dtype.itemsize
    return f"{bits}-bit RGB" if image.ndim == 3 else f"{bits}-bit thermal or gray"


def eight_bit(
    path: Path, image: Shaped[np.ndarray, "h w *c"], how: Preparation
) -> UInt8[np.ndarray, "h w *c"]:
    """Bring an image to 8 bits, one of one channel to full contrast.

    Args:
        path: names it in messages.
        image: as `read_image` returns it.
        how: percentiles and equalisation.

    Raises:
        InputError: an image of one channel has no contrast.
    """
    import cv2

    if image.ndim == 3:
        return image if image.dtype == np.uint8 else (image // 257).astype(np.uint8)
    low, high = np.percentile(image, (how.low_percent, how.high_percent))
    if not high > low:
        low, high = float(image.min()), float(image.max())
    if not high > low:
        raise fail(path, "has one value in all pixels", "remove the image and its pose")
    gray = np.clip((image - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    if how.clahe_clip <= 0:
        return gray
    tiles = (how.clahe_tiles, how.clahe_tiles)
    return cv2.createCLAHE(clipLimit=how.clahe_clip, tileGridSize=tiles).apply(gray)


def names_below(folder: Path, paths: Sequence[Path]) -> list[str]:
    """Return paths relative to their folder, as text."""
    return [path.relative_to(folder).as_posix() for path in paths]
