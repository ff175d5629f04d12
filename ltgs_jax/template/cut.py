"""Which splats of the present scene belong to an object that left its place."""

import numpy as np
import scipy.sparse as sparse
import scipy.sparse.linalg as sparse_linalg
from jaxtyping import Float, Int
from scipy.spatial import cKDTree


def neighbour_graph(
    means: Float[np.ndarray, "n 3"], colors: Float[np.ndarray, "n 3"], *, neighbours: int = 12, color_scale: float = 0.1
) -> sparse.csr_matrix:
    """Symmetric affinities between each splat and its nearest ones: near and alike in colour is strong."""
    distances, index = cKDTree(means).query(means, k=min(neighbours + 1, len(means)))
    distances, index = distances[:, 1:], index[:, 1:]
    length = np.median(distances) + 1e-12
    difference = np.linalg.norm(colors[:, None] - colors[index], axis=-1)
    affinity = np.exp(-((distances / (2 * length)) ** 2) - (difference / color_scale) ** 2) + 1e-4
    rows = np.repeat(np.arange(len(means)), index.shape[1])
    graph = sparse.csr_matrix((affinity.ravel(), (rows, index.ravel())), shape=(len(means),) * 2)
    return graph.maximum(graph.T)


def random_walk(
    graph: sparse.csr_matrix, foreground: Float[np.ndarray, " n"], background: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Probability of foreground: the harmonic function of the graph with soft evidence for either side at each node.

    Random walker segmentation with priors (Grady 2005). Nodes without evidence take that of their surroundings.
    """
    degree = np.asarray(graph.sum(axis=1)).ravel()
    system = sparse.diags(degree + foreground + background + 1e-6) - graph
    solution, _ = sparse_linalg.cg(
        system.tocsr(), foreground + 0.0, rtol=1e-4, maxiter=500, M=sparse.diags(1 / system.diagonal())
    )
    return np.clip(solution, 0, 1)


def components(means: Float[np.ndarray, "n 3"], radius: float) -> Int[np.ndarray, " n"]:
    """Label of the connected component of points nearer to each other than `radius`, largest component first."""
    if len(means) == 0:
        return np.zeros(0, int)
    pairs = cKDTree(means).query_pairs(radius, output_type="ndarray")
    graph = sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(means),) * 2)
    _, labels = sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(-np.bincount(labels), kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    return rank[labels]
