"""`velatura doctor`: what is there, what is wrong with it, and what to do (docs/doctor.md)."""
