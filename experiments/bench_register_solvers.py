"""The solvers that `bench_register` compares: each takes a problem and a noise bound and gives R, t and a verdict."""

import time
import warnings
import zlib  # noqa: F401  before pycolmap, whose own zlib otherwise takes over

import cv2
import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pycolmap
import trimesh

from ltgs_jax.geometry import SE3
from ltgs_jax.register import register
from ltgs_jax.register.hypotheses import Problem
from ltgs_jax.register.outcome import RegisterConfig
from ltgs_jax.register.refine import (
    ResidualLaw,
    final_solve,
    isotropic_whitener,
    robust_residuals,
    whitened_residuals,
)


def kabsch(src: np.ndarray, dst: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Closed-form least squares in float64."""
    a, b = src.mean(0), dst.mean(0)
    u, _, vt = np.linalg.svd((src - a).T @ (dst - b))
    rotmat = vt.T @ np.diag([1, 1, np.linalg.det(vt.T @ u.T)]) @ u.T
    return rotmat, b - rotmat @ a


def _ltgs(problem, bound, covariances=None):
    answer = register(problem["src"], problem["dst"], noise_bound=bound, covariances=covariances)
    matrix = np.asarray(answer.dst_from_src.as_matrix(), np.float64)
    verdict = {"confidence": float(answer.confidence), "result": int(answer.result)}
    return matrix[:3, :3], matrix[:3, 3], verdict | {"distinction": float(answer.distinction)}


def _oracle(problem, bound):
    """Least squares on the true inliers."""
    del bound
    return *kabsch(problem["src"][problem["inl"]], problem["dst"][problem["inl"]]), {}


def _pycolmap(problem, bound):
    options = pycolmap.RANSACOptions(max_error=bound, random_seed=0)
    found = pycolmap.estimate_rigid3d_robust(problem["src"], problem["dst"], options)
    if found is None:
        return None, None, {}
    motion = found.get("tgt_from_src") if isinstance(found, dict) else found
    matrix = np.asarray(motion.matrix())
    return matrix[:, :3], matrix[:, 3], {}


def _opencv(problem, bound):
    """RANSAC on an affine map, then its nearest rotation by least squares on the inliers."""
    cv2.setRNGSeed(0)
    found, _, inlier = cv2.estimateAffine3D(problem["src"], problem["dst"], ransacThreshold=bound, confidence=0.999)
    inlier = inlier.ravel().astype(bool) if found else np.zeros(len(problem["src"]), bool)
    if inlier.sum() < 3:
        return None, None, {}
    return *kabsch(problem["src"][inlier], problem["dst"][inlier]), {}


def _icp(problem, bound):
    """Closest points from the centroids; no features, no search."""
    del bound
    start = np.eye(4)
    start[:3, 3] = problem["dst"].mean(0) - problem["src"].mean(0)
    matrix, _, _ = trimesh.registration.icp(
        problem["src"], problem["dst"], initial=start, scale=False, reflection=False
    )
    return matrix[:3, :3], matrix[:3, 3], {}


def _ltgs_covariances(problem, bound):
    return _ltgs(problem, bound, problem["cov"])


SOLVERS = {
    "ltgs": _ltgs,
    "ltgs_covariances": _ltgs_covariances,
    "oracle": _oracle,
    "pycolmap": _pycolmap,
    "opencv": _opencv,
    "icp": _icp,
}


def ellipsoid_problem(count: int, *, outliers: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """src, dst and R of a lopsided ellipsoid of size 1 with noise 0.01 and outliers on the object."""
    rng = np.random.default_rng(seed)
    src = rng.normal(size=(count, 3))
    src /= np.linalg.norm(src, axis=1, keepdims=True)
    src *= (0.4 + 0.1 * src[:, :1] * src[:, 1:2]) * np.array([1.0, 0.8, 0.6])
    rotmat, _ = kabsch(rng.normal(size=(9, 3)), rng.normal(size=(9, 3)))
    partner = np.arange(count)
    wrong = rng.permutation(count)[: round(outliers * count)]
    partner[wrong] = np.roll(wrong, 1)
    return src, src[partner] @ rotmat.T + 0.01 * rng.normal(size=src.shape), rotmat


def compare_inner(cases: list[dict], errors, sigmas: float) -> list[dict]:
    """Rows: final robust least squares by each solver from starts 1° and 1 % off, error and time."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt

    config, law = RegisterConfig(), ResidualLaw.of_bound(jnp.float32)
    start_off = SE3.exp(jnp.asarray([0.01, -0.01, 0.01, 0.01, 0.01, -0.01], jnp.float32))

    def residuals(tangent, start, problem):
        motion = start @ SE3.exp(tangent)
        return robust_residuals(whitened_residuals(motion, problem, isotropic_whitener(problem)), law).ravel()

    def by_jaxopt(kind):
        def solve(start, problem):
            solver = kind(lambda y: residuals(y, start, problem), maxiter=config.max_steps)
            return start @ SE3.exp(solver.run(jnp.zeros(6, jnp.float32)).params)

        return solve

    def by_optimistix(kind):
        def solve(start, problem):
            found = optx.least_squares(
                lambda y, _: residuals(y, start, problem), kind, jnp.zeros(6), max_steps=config.max_steps, throw=False
            )
            return start @ SE3.exp(found.value)

        return solve

    def by_room(start, problem):
        return final_solve(start, problem, isotropic_whitener(problem), law, config)[0]

    kinds = {
        "room (optimistix LM, normal equations)": by_room,
        "optimistix LevenbergMarquardt": by_optimistix(optx.LevenbergMarquardt(rtol=1e-5, atol=1e-5)),
        "optimistix Dogleg": by_optimistix(optx.Dogleg(rtol=1e-5, atol=1e-5)),
        "jaxopt LevenbergMarquardt": by_jaxopt(jaxopt.LevenbergMarquardt),
        "jaxopt GaussNewton": by_jaxopt(jaxopt.GaussNewton),
    }
    rows = []
    for name, kind in kinds.items():
        solve = jax.jit(kind)
        angles, cpus = [], []
        for index, case in enumerate(cases):
            arrays = (jnp.asarray(case[key], jnp.float32) for key in ("src", "dst"))
            problem = Problem(*arrays, jnp.ones(len(case["src"])), jnp.float32(sigmas * case["sigma"]))
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = case["R"], case["t"]
            start = SE3.from_matrix(jnp.asarray(matrix, jnp.float32)) @ start_off
            if index == 0:
                begin = time.process_time()
                jax.block_until_ready(solve(start, problem))
                first = time.process_time() - begin
            begin = time.process_time()
            found = np.asarray(jax.block_until_ready(solve(start, problem)).as_matrix(), np.float64)
            cpus.append(time.process_time() - begin)
            angles.append(errors(case, found[:3, :3], found[:3, 3])[0])
        rows.append(
            {
                "solver": name,
                "rotation_deg": float(np.median(angles)),
                "cpu_ms": 1e3 * float(np.median(cpus)),
                "first_s": first,
            }
        )
    return rows
