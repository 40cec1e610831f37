"""`velatura doctor`: what is connected, what is wrong with it, what to do (docs/how-to/doctor.md). Entry: `examine`,
`outputs`.
"""
