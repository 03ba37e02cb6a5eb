"""What the speed of the simulator is measured with: a walker-like body, clocks, and a naive step beside it."""
