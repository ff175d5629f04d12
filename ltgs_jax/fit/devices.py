"""The gradient of a step over a batch of photographs, dealt out over devices."""

import math
from collections.abc import Callable
from typing import TypeVar

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh
from jax.sharding import PartitionSpec as P
from jaxtyping import Array, PyTree

T = TypeVar("T")


def mesh_for(batch: int) -> Mesh:
    """As many of the devices as a batch can be dealt out over evenly, in a mesh of one axis."""
    count = math.gcd(batch, jax.device_count())
    return Mesh(np.asarray(jax.devices()[:count]), ("view",), axis_types=(AxisType.Auto,))


def mean_gradient(
    objective: Callable[[T, PyTree, PyTree], tuple[Array, tuple[Array, Array]]],
    variables: T,
    batch: PyTree,
    shared: PyTree,
    mesh: Mesh,
) -> tuple[T, Array, Array]:
    """Mean over a batch of the gradient of `objective(variables, item, shared)` by the variables, the mean of the loss
    and the sum of the overflow that it returns beside what is differentiated.

    `batch`: leaves with a leading axis of items, dealt out over the mesh; each device treats its own in turn, so that
    its memory is that of one. The result does not depend on the number of devices, but for the order of the sums.
    """

    if jax.tree.leaves(batch)[0].shape[0] == 1:  # compiled in two thirds of the time
        item = jax.tree.map(lambda leaf: leaf[0], batch)
        gradient, (loss, overflow) = jax.grad(objective, has_aux=True)(variables, item, shared)
        return gradient, loss, overflow

    def one(variables, batch, shared):
        gradients, (losses, overflows) = jax.lax.map(
            lambda item: jax.grad(objective, has_aux=True)(variables, item, shared), batch
        )
        gradient, loss = jax.tree.map(lambda leaf: jnp.mean(leaf, axis=0), (gradients, losses))
        return *jax.lax.pmean((gradient, loss), "view"), jax.lax.psum(jnp.sum(overflows), "view")

    share = jax.shard_map(one, mesh=mesh, in_specs=(P(), P("view"), P()), out_specs=P(), check_vma=False)
    return share(variables, batch, shared)


def stacked(items: list[T]) -> T:
    """Items alike in structure, as one with a leading axis."""
    return jax.tree.map(lambda *leaves: np.stack(leaves), *items)
