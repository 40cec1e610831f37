"""What was measured, for people (report.html) and for machines (report.json): `calibration`, `comparison`,
`demo`.
"""
