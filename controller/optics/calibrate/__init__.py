"""From photographs to a calibration; takes arrays, returns arrays. One package per stage of the work; `values`
holds what they share.
"""
