"""The paper's experiments, done again on a calibrated stage with photographs alone."""
