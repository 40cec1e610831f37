"""Operations on a stage, one module each: `calibrate.calibrate`, `play.play`, `export.export`
and so on. Commands and the kiosk both call these.
"""
