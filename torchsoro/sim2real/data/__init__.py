"""Experiments on disk: the setup that is believed, and recorded marker positions."""
