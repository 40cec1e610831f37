"""What experiments work with: the calibrated stage (`subject`), disturbances, photographs, figures of merit."""
