"""Access over HTTP: sessions, log-in routes, identity of a request, and the guard before every route."""
