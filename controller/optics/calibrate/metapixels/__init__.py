"""Where each projector pixel lands in the camera picture, as a Gaussian. Entry: `from_phase.fit_pixels`,
`from_dots`.
"""
