"""What a person can ask of a stage, one module an operation: `calibrate.calibrate`, `play.play`, `export.export`
and so on. Commands and the kiosk both call these.
"""
