"""The commands by groups. Each is thin: it parses, calls one function elsewhere, and shows the result."""
