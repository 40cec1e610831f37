"""What a run leaves in its folder: each kind of file is written and read in one place, by type, with its units.
`names` makes file names, `kinds` the identities of steps; entry: `calibration.read_calibration`,
`calibrated.Calibrated`, `photographs.PhotographSet`.
"""
