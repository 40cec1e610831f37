"""The paper's solver by regions (paper 3.2, eq. 7), kept for comparison. Entry: `solver`."""
