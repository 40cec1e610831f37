"""Long jobs of the kiosk: `job_runner` runs them in a thread, `job_handlers` has a handler for each kind, `failover`
computes frames without a lost projector.
"""
