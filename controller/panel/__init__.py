"""The technician's web panel and the HTTP API; web only, everything else is asked of `controller.kiosk`. Entry:
`app`, `server`.
"""
