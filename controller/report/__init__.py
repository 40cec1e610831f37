"""What was measured, for people (report.html) and for machines (report.json)."""
