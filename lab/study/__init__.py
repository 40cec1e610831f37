"""The paper's experiments, repeated on a calibrated stage with photographs. Entry: `catalogue`; `values` says
what an experiment is.
"""
