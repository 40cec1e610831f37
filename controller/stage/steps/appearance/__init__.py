"""Steps from a calibration to installed appearances: requests, solving, rendering, publishing, comparing, live.
Entry: `solving.solve_steps`.
"""
