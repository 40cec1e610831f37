"""Long work of the kiosk: `job_runner` runs it in a thread, `job_handlers` says what each kind does, `failover`
drops a lost projector.
"""
