"""NeuMA: neural material adaptor for visual grounding of intrinsic dynamics (NeurIPS 2024), as a library."""

__version__ = "0.1.0"
