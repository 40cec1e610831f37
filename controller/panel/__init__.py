"""The technician's web panel and the HTTP API. It contains only web code and uses `controller.kiosk` for the rest.
Entry points: `app`, `server`.
"""
