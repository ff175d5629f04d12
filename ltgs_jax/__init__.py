"""Long-term Gaussian scene chronology in JAX."""

__version__ = "0.1.0"
