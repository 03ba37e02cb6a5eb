"""From recordings to a verdict: residual, likelihood, fit, search, confirmation."""
