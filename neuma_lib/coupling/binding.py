"""The binding matrix B: the weights of the particles that move a Gaussian (paper Algorithm 1)."""

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(frozen=True)
class Binding:
    """Sparse binding matrix B in compressed sparse row (CSR) format."""

    indptr: Tensor  # start of each row in ``indices``, int64, shape (G + 1,)
    indices: Tensor  # bound particles, ascending in each row, int64, shape (nnz,)
    values: Tensor  # weights, shape (nnz,); every non-empty row sums to 1
    shape: tuple[int, int]  # (Gaussian count G, particle count N)
    _compressed: dict = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def identity(cls, count: int, like: Tensor) -> "Binding":
        """One particle for each of ``count`` Gaussians (the paper's "w/o Bind"), with device and dtype of ``like``."""
        index = torch.arange(count + 1, device=like.device)
        return cls(index, index[:-1].clone(), like.new_ones(count), (count, count))

    @property
    def counts(self) -> Tensor:
        """Number of bound particles of each Gaussian, int64, shape (G,)."""
        return self.indptr[1:] - self.indptr[:-1]

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> "Binding":
        """The same matrix on another device or with weights of another dtype."""
        values = self.values.to(device=device, dtype=dtype)
        return Binding(self.indptr.to(device), self.indices.to(device), values, self.shape)

    def rows(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """B in CSR format for kernels: indptr and indices as int32, weights of the given dtype; cached."""
        if ("rows", dtype) not in self._compressed:
            self._compressed["rows", dtype] = (self.indptr.int(), self.indices.int(), self.values.to(dtype))
        return self._compressed["rows", dtype]

    def columns(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """B^T in the same format, for adjoints; cached."""
        if ("columns", dtype) not in self._compressed:
            rows = torch.repeat_interleave(
                torch.arange(self.shape[0], device=self.indptr.device), self.counts
            )
            order = torch.argsort(self.indices, stable=True)
            counts = torch.bincount(self.indices, minlength=self.shape[1])
            indptr = torch.cat([counts.new_zeros(1), counts.cumsum(0)])
            columns = (indptr.int(), rows[order].int(), self.values[order].to(dtype))
            self._compressed["columns", dtype] = columns
        return self._compressed["columns", dtype]
