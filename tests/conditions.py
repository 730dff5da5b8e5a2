"""Why some tests are skipped."""

from __future__ import annotations

import os

import pytest
import torch

posix_only = pytest.mark.skipif(os.name != "posix", reason="uses POSIX files, limits or signals")
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device on this machine")
