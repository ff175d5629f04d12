"""Rotations as wxyz quaternions and rigid motions, float dtype as given."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.lax import Precision
from jaxtyping import Array, Float


def _unit(w: Array, x: Array, y: Array, z: Array) -> tuple[Array, ...]:
    """Components of `normalize_quats`, elementwise."""
    # Scaling by the largest component first keeps float32 from over- or underflowing in the squares.
    largest = jax.lax.stop_gradient(jnp.maximum(jnp.maximum(abs(w), abs(x)), jnp.maximum(abs(y), abs(z))))
    usable = largest > 0
    safe = jnp.where(usable, largest, 1)
    w, x, y, z = jnp.where(usable, w / safe, 1), *(jnp.where(usable, v / safe, 0) for v in (x, y, z))
    shrink = 1 / jnp.sqrt(w * w + x * x + y * y + z * z)
    return w * shrink, x * shrink, y * shrink, z * shrink


def normalize_quats(quats: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Unit quaternions; a zero quaternion becomes the identity, with zero gradient there."""
    return jnp.stack(_unit(*jnp.moveaxis(quats, -1, 0)), axis=-1)


def rotmat_entries(w: Array, x: Array, y: Array, z: Array) -> list[list[Array]]:
    """The nine entries, row by row, of the rotation matrices of wxyz quaternions, which need not be unit.

    Elementwise in arrays of any one shape: many times faster on CPUs than arithmetic along a short last axis.
    """
    w, x, y, z = _unit(w, x, y, z)
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


@jax.jit
def rotmat_from_quat(quats: Float[Array, "... 4"]) -> Float[Array, "... 3 3"]:
    """Rotation matrices of wxyz quaternions, which need not be unit."""
    rows = rotmat_entries(*jnp.moveaxis(quats, -1, 0))
    return jnp.stack([jnp.stack(row, axis=-1) for row in rows], axis=-2)


@jax.jit
def quat_from_rotmat(rotmat: Float[Array, "... 3 3"]) -> Float[Array, "... 4"]:
    """wxyz quaternions of rotation matrices, by the best conditioned of the four branches (Shepperd 1978)."""
    m = [[rotmat[..., i, j] for j in range(3)] for i in range(3)]
    four_squares = jnp.stack(
        [
            1 + m[0][0] + m[1][1] + m[2][2],
            1 + m[0][0] - m[1][1] - m[2][2],
            1 - m[0][0] + m[1][1] - m[2][2],
            1 - m[0][0] - m[1][1] + m[2][2],
        ],
        axis=-1,
    )
    a, b, c = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    d, e, f = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    t = [four_squares[..., i] for i in range(4)]
    candidates = jnp.stack(
        [
            jnp.stack([t[0], a, b, c], axis=-1),
            jnp.stack([a, t[1], d, e], axis=-1),
            jnp.stack([b, d, t[2], f], axis=-1),
            jnp.stack([c, e, f, t[3]], axis=-1),
        ],
        axis=-2,
    )
    best = jnp.argmax(four_squares, axis=-1)
    quat = jnp.take_along_axis(candidates, best[..., None, None], axis=-2)[..., 0, :]
    return normalize_quats(quat)


@jax.jit
def multiply_quats(a: Float[Array, "... 4"], b: Float[Array, "... 4"]) -> Float[Array, "... 4"]:
    """Hamilton product a·b."""
    aw, ax, ay, az = jnp.moveaxis(a, -1, 0)
    bw, bx, by, bz = jnp.moveaxis(b, -1, 0)
    return jnp.stack(
        [
            aw * bw - ax * bx - ay * by - az * bz,
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
        ],
        axis=-1,
    )


def rotation_angle(quats: Float[Array, "... 4"]) -> Float[Array, "..."]:
    """Angle in radians, 2·atan2(‖v‖, |w|): exact near 0 and near π, where arccos is not."""
    return 2 * jnp.arctan2(jnp.linalg.norm(quats[..., 1:], axis=-1), jnp.abs(quats[..., 0]))


class SE3(eqx.Module):
    """Rigid motions x_b = R·x_a + t, batched over leading axes.

    `quat` [... 4] wxyz (need not be unit), `xyz` [... 3] in scene units.
    """

    quat: Float[Array, "... 4"]
    xyz: Float[Array, "... 3"]

    @staticmethod
    def identity(shape: tuple[int, ...] = (), dtype=jnp.float32) -> "SE3":
        """The identity, repeated over `shape`."""
        return SE3(jnp.zeros((*shape, 4), dtype).at[..., 0].set(1), jnp.zeros((*shape, 3), dtype))

    @staticmethod
    def from_matrix(matrix: Float[Array, "... 4 4"]) -> "SE3":
        """From 4×4 (or 3×4) matrices whose left block is a rotation."""
        matrix = jnp.asarray(matrix)
        return SE3(quat_from_rotmat(matrix[..., :3, :3]), matrix[..., :3, 3])

    @staticmethod
    @jax.jit
    def exp(tangent: Float[Array, "... 6"]) -> "SE3":
        """Exponential of (v, ω), translation first; smooth, derivatives included, at ω = 0."""
        v, omega = tangent[..., :3], tangent[..., 3:]
        theta2 = jnp.sum(omega * omega, axis=-1, keepdims=True)
        # Below this angle² the series' next term is under the dtype's precision.
        small = theta2 < jnp.finfo(tangent.dtype).eps ** 0.5
        safe2 = jnp.where(small, 1, theta2)
        theta = jnp.sqrt(safe2)
        half_sinc = jnp.where(small, 0.5 - theta2 / 48 + theta2**2 / 3840, jnp.sin(theta / 2) / theta)
        cos_half = jnp.where(small, 1 - theta2 / 8 + theta2**2 / 384, jnp.cos(theta / 2))
        b = jnp.where(small, 0.5 - theta2 / 24 + theta2**2 / 720, 2 * (jnp.sin(theta / 2) / theta) ** 2)
        c = jnp.where(small, 1 / 6 - theta2 / 120 + theta2**2 / 5040, (theta - jnp.sin(theta)) / (safe2 * theta))
        cross = jnp.cross(omega, v)
        return SE3(jnp.concatenate([cos_half, half_sinc * omega], axis=-1), v + b * cross + c * jnp.cross(omega, cross))

    def rotmat(self) -> Float[Array, "... 3 3"]:
        """Rotation matrices."""
        return rotmat_from_quat(self.quat)

    @jax.jit
    def as_matrix(self) -> Float[Array, "... 4 4"]:
        """4×4 matrices."""
        top = jnp.concatenate([self.rotmat(), self.xyz[..., None]], axis=-1)
        bottom = jnp.broadcast_to(jnp.zeros(4, top.dtype).at[3].set(1), (*top.shape[:-2], 1, 4))
        return jnp.concatenate([top, bottom], axis=-2)

    @jax.jit
    def inverse(self) -> "SE3":
        """a_from_b of b_from_a."""
        conjugate = self.quat * jnp.asarray([1, -1, -1, -1], self.quat.dtype)
        rotated = jnp.einsum("...ij,...j->...i", rotmat_from_quat(conjugate), self.xyz, precision=Precision.HIGHEST)
        return SE3(conjugate, -rotated)

    @jax.jit
    def apply(self, points: Float[Array, "... n 3"]) -> Float[Array, "... n 3"]:
        """Move points; the rotation matrix is formed once, not per point."""
        rotated = jnp.einsum("...ij,...nj->...ni", self.rotmat(), points, precision=Precision.HIGHEST)
        return rotated + self.xyz[..., None, :]

    @jax.jit
    def __matmul__(self, other: "SE3") -> "SE3":
        """Composition: (self @ other)(x) = self(other(x))."""
        moved = jnp.einsum("...ij,...j->...i", self.rotmat(), other.xyz, precision=Precision.HIGHEST)
        return SE3(multiply_quats(self.quat, other.quat), moved + self.xyz)

    def __getitem__(self, index) -> "SE3":
        """Index the leading axes."""
        return jax.tree.map(lambda leaf: leaf[index], self)
