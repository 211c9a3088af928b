"""More devices, more machines: the same program, its leading axis cut over a mesh.

Every process runs the same lines on the same inputs and ends with the same results; only the work
is shared. One process needs nothing. Several call `jax.distributed.initialize` first.
"""

from typing import Any

import jax
import numpy as np
from jax.experimental.multihost_utils import process_allgather
from jax.sharding import Mesh, NamedSharding, PartitionSpec

AXIS = "device"
"""The mesh has one axis."""

CUT, WHOLE = PartitionSpec(AXIS), PartitionSpec()
"""Where an array lives: its leading axis cut over the devices, or all of it on each."""


def device_mesh() -> Mesh:
    """Return the line of all devices of all processes, those of one process side by side."""
    return Mesh(np.array(jax.devices()), (AXIS,))


def place(tree: Any, mesh: Mesh, where: PartitionSpec) -> Any:
    """Put arrays on the devices of a mesh; each process reads only what its own devices hold.

    Args:
        tree: leaves that numpy can slice, the same in every process; with `CUT`, leading axes
            divide by the number of devices.
        mesh: from `device_mesh`.
        where: `CUT` or `WHOLE`.

    Returns:
        The same tree of global arrays.

    Raises:
        ValueError: a leading axis does not divide by the number of devices.
    """
    sharding = NamedSharding(mesh, where)

    def put(leaf: Any) -> jax.Array:
        # Whole on the host, where it is cheap; a memory map is read in slices only.
        host = np.asanyarray(leaf)
        return jax.make_array_from_callback(host.shape, sharding, lambda part: host[part])

    return jax.tree.map(put, tree)


def gather(tree: Any) -> Any:
    """Return global arrays as numpy arrays, whole in every process."""

    def whole(leaf: jax.Array) -> np.ndarray:
        # Gathering what a process already holds would repeat it once per process.
        return np.asarray(
            leaf if leaf.is_fully_addressable else process_allgather(leaf, tiled=True)
        )

    return jax.tree.map(whole, tree)
