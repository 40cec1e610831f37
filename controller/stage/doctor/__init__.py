"""`velatura doctor`: finds devices, their faults and the remedies (docs/how-to/doctor.md). Entry: `examine`,
`outputs`.
"""
