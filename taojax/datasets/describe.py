"""Folders of images, 8- or 16-bit thermal or RGB, to descriptors: a user's network, or GIST."""

import dataclasses
import hashlib
import json
import os
import re
import shutil
from collections.abc import Callable, Iterator, Sequence
from decimal import Decimal
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped, UInt8

from taojax.errors import InputError, MissingExtraError
from taojax.files.records import digest_file
from taojax.files.specs import fail, first_line, read_bytes, write_atomically

__all__ = [
    "Described",
    "Network",
    "Preparation",
    "describe",
    "eight_bit",
    "gist",
    "kind_of_image",
    "list_images",
    "natural",
    "read_image",
]

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


_NUMBER = re.compile(r"[0-9]+([.][0-9]+)?").fullmatch


def natural(text: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts 9 before 10."""
    words = "".join(c if c.isdecimal() else " " + c + " " for c in text).split()
    return [(0, int(word), "") if word.isdecimal() else (1, 0, word) for word in words]


def list_images(folder: Path) -> tuple[list[Path], str]:
    """List the images below a folder in the order in which they were taken.

    Args:
        folder: hidden files and other endings are passed over.

    Returns:
        Paths, and what orders them: names, the numbers in them, or the numbers that they are.

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
    name_of = lambda path: path.relative_to(folder).as_posix()
    if len({path.parent for path in found}) == 1 and all(_NUMBER(path.stem) for path in found):
        return sorted(found, key=lambda path: (Decimal(path.stem), path.name)), "numbers"
    # Nobody means frame_10 to come before frame_9.
    counted = sorted(found, key=lambda path: (natural(name_of(path)), path.name))
    is_text = counted == sorted(found, key=name_of)
    return counted, "names" if is_text else "names, numbers in them by size"


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


SIDE, PLACES, DIRECTIONS, SCALES = 128, 8, 8, 3
"""Of GIST: pixels of the thumbnail, places along a side, and the filters."""

KERNEL, SIGMA, WAVE = 13, 2.2, 4.0
"""Pixels of a Gabor filter, its width and its wave length; scales halve the image instead."""

IMAGENET = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and deviation that most networks subtract and divide by."""

GRAY = (0.299, 0.587, 0.114)
"""Weights of red, green and blue in a gray image."""

DYNAMIC = 14
"""Sides of an input of any size are cut to multiples of this, the patch of DINOv2."""


Describer = Callable[[Sequence[np.ndarray]], np.ndarray]
"""Turns prepared images into one row each."""


@dataclasses.dataclass(frozen=True)
class Network:
    """A user's ONNX model and how images are laid before it."""

    path: Path
    size: tuple[int, int] | None = None
    """Width and height; None: as the model says, else the image's own, in multiples of 14."""

    mean: tuple[float, ...] | None = None
    """Of each channel, from 0 to 1; None: ImageNet's, of one channel 0."""

    deviation: tuple[float, ...] | None = None
    """None: ImageNet's, of one channel 1."""


@dataclasses.dataclass(frozen=True)
class Described:
    """What was written."""

    n_images: int
    dimension: int
    n_resumed: int
    """Rows that an interrupted run had finished."""

    kind: str
    order: str


def gist(gray: UInt8[np.ndarray, "h w"]) -> Float[np.ndarray, " d"]:
    """Describe one gray image.

    Args:
        gray: any size, of full contrast.

    Returns:
        (1536,) float32: energies of each filter over the places, less their mean, at unit length.
    """
    import cv2

    image = cv2.resize(gray, (SIDE, SIDE), interpolation=cv2.INTER_AREA).astype(np.float32)
    rows = []
    for scale in range(SCALES):
        image = image if scale == 0 else cv2.pyrDown(image)
        for even, odd in _filters():
            parts = (cv2.filter2D(image, cv2.CV_32F, kernel) for kernel in (even, odd))
            energy = np.sqrt(sum(part**2 for part in parts))
            rows.append(cv2.resize(energy, (PLACES, PLACES), interpolation=cv2.INTER_AREA).ravel())
    energies = np.array(rows, np.float64)
    energies /= np.maximum(np.linalg.norm(energies, axis=1, keepdims=True), 1e-6)
    row = (energies - energies.mean(axis=1, keepdims=True)).ravel()
    return (row / max(float(np.linalg.norm(row)), 1e-12)).astype(np.float32)


def _filters() -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield even and odd Gabor filters of every direction; none answers to brightness."""
    import cv2

    for k in range(DIRECTIONS):
        angle = k * np.pi / DIRECTIONS
        pair = [
            cv2.getGaborKernel((KERNEL, KERNEL), SIGMA, angle, WAVE, 1.0, phase)
            for phase in (0.0, np.pi / 2)
        ]
        yield pair[0] - pair[0].mean(), pair[1] - pair[1].mean()


def _as_gray(image: np.ndarray) -> np.ndarray:
    return image if image.ndim == 2 else (image @ np.array(GRAY)).round().astype(np.uint8)


def _classical() -> tuple[Describer, dict[str, Any]]:
    def rows(images: Sequence[np.ndarray]) -> np.ndarray:
        return np.stack([gist(_as_gray(image)) for image in images])

    told = {"method": "gist", "thumbnail": [SIDE, SIDE], "gray_of_rgb": list(GRAY),
            "places": PLACES, "directions": DIRECTIONS, "scales": SCALES}  # fmt: skip
    return rows, told


def _network(own: Network) -> tuple[Describer, dict[str, Any]]:
    """Open a model and say how its input is made.

    Raises:
        InputError: it is no ONNX model of one image input.
        MissingExtraError: onnxruntime is not installed.
    """
    try:
        import onnxruntime
    except ImportError as error:
        raise MissingExtraError(f"models need onnxruntime; run: {COMMAND}") from error
    if own.path.suffix.lower() != ".onnx":
        raise fail(own.path, "is no .onnx model", "export it with torch.onnx.export")
    digest = digest_file(own.path)
    try:
        session = onnxruntime.InferenceSession(str(own.path), providers=["CPUExecutionProvider"])
    # Damaged models surface as exceptions of the native library, which share no other root.
    except Exception as error:
        what = f"is not a readable ONNX model ({first_line(error)})"
        raise fail(own.path, what, "export it again") from error
    first = session.get_inputs()[0]
    shape = list(first.shape)
    if len(session.get_inputs()) != 1 or len(shape) != 4 or shape[1] not in (1, 3):
        what = f"has {len(session.get_inputs())} input(s), the first of shape {shape}"
        raise fail(own.path, what, "expected one image input (N, 1 or 3, H, W)")
    channels = int(shape[1])
    fixed = (shape[3], shape[2]) if all(isinstance(n, int) for n in shape[2:]) else None
    if own.size is not None and fixed not in (None, own.size):
        raise fail(own.path, f"wants {fixed[0]} x {fixed[1]} pixels", "leave --size away")
    size = own.size or fixed
    usual = IMAGENET if channels == 3 else ((0.0,), (1.0,))
    mean = np.array((own.mean or usual[0])[:channels], np.float32)
    deviation = np.array((own.deviation or usual[1])[:channels], np.float32)
    one_by_one = isinstance(shape[0], int) and shape[0] == 1

    def rows(images: Sequence[np.ndarray]) -> np.ndarray:
        inputs = np.stack([_input(image, size, channels, mean, deviation) for image in images])
        parts = [inputs[k : k + 1] for k in range(len(inputs))] if one_by_one else [inputs]
        out = [np.asarray(session.run(None, {first.name: part})[0]) for part in parts]
        return np.concatenate([part.reshape(len(part), -1) for part in out]).astype(np.float32)

    told = {"method": "onnx", "model": own.path.name, "model_sha256": digest,
            "input": first.name, "channels": channels,
            "size": list(size) if size else f"own, cut to multiples of {DYNAMIC}",
            "scaled": "0 to 1, then less the mean, over the deviation",
            "mean": [float(v) for v in mean], "deviation": [float(v) for v in deviation],
            "resampling": "bilinear"}  # fmt: skip
    return rows, told


def _input(
    image: np.ndarray, size: tuple[int, int] | None, channels: int, mean: np.ndarray,
    deviation: np.ndarray,
) -> np.ndarray:  # fmt: skip
    """Return (C, H, W) float32 of one image."""
    import cv2

    height, width = image.shape[:2]
    size = size or (width // DYNAMIC * DYNAMIC, height // DYNAMIC * DYNAMIC)
    planes = _as_gray(image)[:, :, None] if channels == 1 else (
        np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image
    )  # fmt: skip
    scaled = planes.astype(np.float32) / 255
    resized = cv2.resize(scaled, size, interpolation=cv2.INTER_LINEAR).reshape(*size[::-1], -1)
    return ((resized - mean[None, None]) / deviation[None, None]).transpose(2, 0, 1)


def describe(
    folder: Path,
    out: Path,
    *,
    how: Preparation,
    network: Network | None = None,
    batch: int = 16,
    tell: Callable[[Sequence[int]], Iterator[int]] = iter,
) -> Described:
    """Describe all images of a folder, and write beside the rows how they were made.

    A run that was interrupted goes on where it stopped, as long as images and preparation are the
    same.

    Args:
        folder: images, thermal or RGB, all of one kind.
        out: an .npy to make; the recipe goes to the same name with .toml.
        how: how images of one channel come to 8 bits.
        network: a model; None: GIST.
        batch: images at a time.
        tell: wraps the batches, to draw progress.

    Returns:
        What was written: (N, D) float32, one row per image in the order of the .toml's names.

    Raises:
        InputError: `out` is there, an image is damaged or of another kind, or the rows are not
            finite.
        MissingExtraError: a package is not installed.
    """
    recipe = out.with_suffix(".toml")
    if out.suffix.lower() != ".npy":
        raise fail(out, "is no .npy", "give --out NAME.npy")
    for path in (out, recipe):
        if path.exists():
            raise fail(path, "is there already", "it is never overwritten: choose another --out")
    paths, order = list_images(folder)
    kind = kind_of_image(read_image(paths[0]))
    rows_of, told = _classical() if network is None else _network(network)
    told |= dataclasses.asdict(how) if "RGB" not in kind else {}
    head = {"images": str(folder), "kind": kind, "order": order, **told}
    key = _key(head, paths)
    held = _Held(out, key)
    starts = range(held.done, len(paths), batch)
    try:
        for start in tell(starts):
            own = paths[start : start + batch]
            rows = rows_of([_prepared(path, kind, how) for path in own])
            _check_rows(own, rows)
            held.add(start, rows, len(paths))
    except InputError:
        # Once the image is mended or removed they are other images, and the run starts anew.
        held.drop()
        raise
    names = names_below(folder, paths)
    lines = [f"{name} = {json.dumps(value, ensure_ascii=False)}" for name, value in head.items()]
    lines.append(f"names = {json.dumps(names, ensure_ascii=False, indent=0)}")
    write_atomically(recipe, "\n".join(lines) + "\n")
    dimension = held.finish()
    return Described(len(paths), dimension, held.n_resumed, kind, order)


def _prepared(path: Path, kind: str, how: Preparation) -> np.ndarray:
    image = read_image(path)
    if (own := kind_of_image(image)) != kind and not ("RGB" in kind and own[:2] == kind[:2]):
        raise fail(path, f"is a {own} image, the first is {kind}", "keep one kind in a folder")
    if image.ndim == 2 and "RGB" in kind:
        image = np.repeat(image[:, :, None], 3, axis=2)
    return eight_bit(path, image, how)


def _check_rows(paths: Sequence[Path], rows: np.ndarray) -> None:
    wrong = ~(np.isfinite(rows).all(axis=1) & (np.abs(rows).max(axis=1) > 0))
    if wrong.any():
        what = "its descriptor is not finite or all zero"
        raise fail(paths[int(np.argmax(wrong))], what, "check the model, or remove the image")


def _key(head: dict[str, Any], paths: Sequence[Path]) -> str:
    """Return what tells one run from another: recipe, images and when they were written."""
    told = [(str(p), p.stat().st_size, p.stat().st_mtime_ns) for p in paths]
    return hashlib.sha256(json.dumps([head, told], default=str).encode()).hexdigest()


class _Held:
    """Rows of an unfinished run, in a hidden folder beside the result."""

    def __init__(self, out: Path, key: str) -> None:
        self._out, self._key = out, key
        self._folder = out.with_name(f".{out.name}.unfinished")
        self._rows, self._state = self._folder / "rows.npy", self._folder / "state.json"
        self.done = self._resume()
        self.n_resumed = self.done

    def _resume(self) -> int:
        try:
            state = json.loads(self._state.read_text(encoding="utf-8"))
            if state["key"] == self._key and self._rows.is_file():
                return int(state["done"])
        except (OSError, ValueError, KeyError, TypeError):
            pass
        shutil.rmtree(self._folder, ignore_errors=True)
        return 0

    def add(self, start: int, rows: np.ndarray, n_all: int) -> None:
        """Keep a batch; what is said to be done is on the disk before."""
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            shape = (n_all, rows.shape[1])
            mode = "r+" if self._rows.is_file() else "w+"
            kept = (
                np.lib.format.open_memmap(self._rows, mode, np.dtype(np.float32), shape)
                if mode == "w+" else np.lib.format.open_memmap(self._rows, mode)
            )  # fmt: skip
            kept[start : start + len(rows)] = rows
            kept.flush()
        except OSError as error:
            what = f"cannot be written ({error.strerror})"
            raise fail(self._out, what, "choose another --out") from error
        done = {"key": self._key, "done": start + len(rows)}
        write_atomically(self._state, json.dumps(done))

    def drop(self) -> None:
        """Leave nothing behind."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def finish(self) -> int:
        """Put the rows in their place and return their length."""
        dimension = int(np.load(self._rows, mmap_mode="r").shape[1])
        os.replace(self._rows, self._out)
        shutil.rmtree(self._folder, ignore_errors=True)
        return dimension
