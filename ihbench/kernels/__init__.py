"""Work-precision of the bench's own kernels, behind `ihbench kernels`: one module a kernel, one table."""
