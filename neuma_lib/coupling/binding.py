"""The binding matrix B: which particles carry a Gaussian, and with what weights (paper Algorithm 1)."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from neuma_lib.errors import InputError


@dataclass(frozen=True)
class Binding:
    """Sparse binding matrix B in compressed rows.

    Attributes:
        indptr: start of each row in ``indices``, int64, shape (G + 1,).
        indices: bound particles, ascending inside a row, int64, shape (nnz,).
        values: weights, shape (nnz,); every non-empty row sums to 1.
        shape: (Gaussian count G, particle count N).
    """

    indptr: Tensor
    indices: Tensor
    values: Tensor
    shape: tuple[int, int]
    _compressed: dict = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def identity(cls, count: int, like: Tensor) -> Binding:
        """Every Gaussian is its own particle (the paper's "w/o Bind"), on the device of ``like``.

        Args:
            count: Gaussians, which are the particles too.
            like: tensor whose device and floating type the weights take.
        """
        index = torch.arange(count + 1, device=like.device)
        return cls(
            index, index[:-1].clone(), torch.ones(count, dtype=like.dtype, device=like.device), (count, count)
        )

    @property
    def counts(self) -> Tensor:
        """Bound particles of every Gaussian, int64, shape (G,)."""
        return self.indptr[1:] - self.indptr[:-1]

    @property
    def orphans(self) -> Tensor:
        """Gaussians that no particle carries, int64, shape (orphan count,)."""
        return torch.nonzero(self.counts == 0).flatten()

    def to(self, device: torch.device | str | None = None, dtype: torch.dtype | None = None) -> Binding:
        """The same matrix on another device or with weights of another floating type."""
        return Binding(
            self.indptr.to(device),
            self.indices.to(device),
            self.values.to(device=device, dtype=dtype),
            self.shape,
        )

    def dense(self) -> Tensor:
        """The matrix B, shape (G, N). For tests and small examples only."""
        matrix = torch.zeros(self.shape, dtype=self.values.dtype, device=self.values.device)
        rows = torch.repeat_interleave(torch.arange(self.shape[0], device=self.indptr.device), self.counts)
        matrix[rows, self.indices] = self.values
        return matrix

    def apply(self, particle_field: Tensor) -> Tensor:
        """Multiply a particle field by B, differentiably in the field.

        Args:
            particle_field: values on particles at T frames, shape (T, N, ...).

        Returns:
            Values on Gaussians, shape (T, G, ...).

        Raises:
            InputError: if the field has another number of particles than the binding.
        """
        if particle_field.ndim < 2 or particle_field.shape[1] != self.shape[1]:
            raise InputError(
                f"binding: a field of shape {tuple(particle_field.shape)} does not fit "
                f"{self.shape[1]} particles; expected (frames, particles, ...). Rerun the binding stage if "
                "the particles changed."
            )
        return _Apply.apply(particle_field, self)

    def rows(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """B in compressed rows for a kernel: indptr and indices as int32, weights of the given dtype; made once."""
        if ("rows", dtype) not in self._compressed:
            self._compressed["rows", dtype] = (self.indptr.int(), self.indices.int(), self.values.to(dtype))
        return self._compressed["rows", dtype]

    def columns(self, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
        """B^T likewise, the Gaussians of each particle: what the adjoint of ``apply`` multiplies with."""
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


class _Apply(torch.autograd.Function):
    """B times a particle field; the adjoint is B^T times the gradient."""

    @staticmethod
    def forward(ctx, particle_field: Tensor, binding: Binding) -> Tensor:
        ctx.binding = binding
        return _multiply(*binding.rows(particle_field.dtype), particle_field)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx, grad: Tensor) -> tuple[Tensor, None]:
        return _multiply(*ctx.binding.columns(grad.dtype), grad), None


def _multiply(indptr: Tensor, indices: Tensor, values: Tensor, columns: Tensor) -> Tensor:
    """Compressed-row matrix (R, K) times a field (T, K, ...), frame by frame: (T, R, ...).

    Bags summed with weights are a sparse product that is fast and deterministic on CPU and CUDA; frames are
    laid side by side, so that each row of indices is read once for all of them.
    """
    frames, _, *rest = columns.shape
    rows = len(indptr) - 1
    side_by_side = columns.transpose(0, 1).reshape(columns.shape[1], -1)
    if side_by_side.shape[1] == 0:
        return columns.new_zeros(frames, rows, *rest)
    product = torch.nn.functional.embedding_bag(
        indices, side_by_side, indptr, mode="sum", per_sample_weights=values, include_last_offset=True
    )
    return product.view(rows, frames, *rest).transpose(0, 1).contiguous()
