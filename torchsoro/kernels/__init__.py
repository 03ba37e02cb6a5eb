"""Taichi kernels: shape functions, stress laws, transfers and node laws, each with its adjoint; torch never enters here."""
