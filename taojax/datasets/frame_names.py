"""Image names as different programs write them: found by whole name, else by the end of it."""

from collections import defaultdict
from collections.abc import Sequence

__all__ = ["Names"]


def _parts(name: str) -> tuple[str, ...]:
    return tuple(part for part in name.replace("\\", "/").split("/") if part not in ("", "."))


class Names:
    """Names of images, and which of them another program's name means."""

    def __init__(self, names: Sequence[str]) -> None:
        self._names = [_parts(name) for name in names]
        self._whole: dict[tuple[str, ...], list[int]] = defaultdict(list)
        self._base: dict[str, list[int]] = defaultdict(list)
        for at, name in enumerate(self._names):
            self._whole[name].append(at)
            self._base[name[-1] if name else ""].append(at)

    def find(self, name: str) -> list[int]:
        """Return where a name lies among these.

        Args:
            name: a path, relative to anything.

        Returns:
            Positions: none for an unknown name, several where it could mean several.
        """
        wanted = _parts(name)
        if wanted in self._whole:
            return self._whole[wanted]
        same_base = self._base.get(wanted[-1] if wanted else "", [])
        if len(same_base) < 2:
            return same_base
        ends = [at for at in same_base if _ends_alike(self._names[at], wanted)]
        return ends or same_base


def _ends_alike(a: tuple[str, ...], b: tuple[str, ...]) -> bool:
    """Tell whether the shorter path is the end of the longer one."""
    n = min(len(a), len(b))
    return a[-n:] == b[-n:]
