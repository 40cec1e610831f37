"""What judges the product and no stage runs: the paper's `study`, `compare`, `simulate`, `timings`, and more emulated
devices.
"""
