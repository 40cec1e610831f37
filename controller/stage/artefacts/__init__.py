"""The files in a run's folder: each kind is written and read in one place, with types and units.
`names` makes file names, `kinds` the identities of steps; entry: `calibration.read_calibration`,
`calibrated.Calibrated`, `photographs.PhotographSet`.
"""
