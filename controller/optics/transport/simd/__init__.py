"""Vector intrinsics (LLVM) for the kernels of transport and scaling, one module per kernel family.

All are made of the helpers in `vectors`. `tests/controller/optics/transport/simd` has each kernel in plain NumPy.
"""
