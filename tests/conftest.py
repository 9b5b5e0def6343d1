"""Settings of every test run."""

import torch

# Two OpenMP threads on a busy machine cost far more than one.
torch.set_num_threads(1)
