"""The precisions that a configuration may name (`ihbench.fit.precision`)."""

from typing import Literal

Precision = Literal["auto", "float32", "bfloat16"]
