"""An explanation for people and for programs."""
