"""The bridge between torch and Taichi, and the only place that knows both."""
