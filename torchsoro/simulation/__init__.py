"""The engine: bodies, what acts on them, and their motion, differentiable in all of it."""
