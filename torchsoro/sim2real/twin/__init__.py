"""The simulated twin of an experiment's body, many variations at a time."""
