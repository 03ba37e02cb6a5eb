"""Why a real robot moves differently from its simulation: recording, residual, hypothesis, fit, report."""
