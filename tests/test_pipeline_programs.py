"""Compiled programs are dropped before a process runs out of memory maps."""

import jax
import jax.numpy as jnp
import pytest

from ltgs_jax.pipeline.programs import _MAPS, free_programs


@pytest.mark.skipif(not _MAPS.exists(), reason="no /proc here")
def test_programs_are_dropped_when_there_are_too_many():
    double = jax.jit(lambda x: 2 * x)
    assert float(double(jnp.ones(()))) == 2
    assert double._cache_size() == 1
    assert not free_programs(most=10**9)
    assert double._cache_size() == 1
    assert free_programs(most=0)
    assert double._cache_size() == 0
    assert float(double(jnp.ones(()))) == 2
