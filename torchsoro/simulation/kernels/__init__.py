"""Taichi kernels: shape functions, stress laws, transfers, node laws and the adjoint of each; torch never enters."""
