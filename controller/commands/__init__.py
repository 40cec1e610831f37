"""Commands, by groups; each is thin: it parses, calls one function elsewhere, and shows what that returns."""
