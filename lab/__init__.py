"""What judges the product and no stage runs: the paper's `study`, `compare`, `simulate` and `timings`."""
