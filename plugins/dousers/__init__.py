"""Dousers, mechanical shutters in front of lenses, by sACN: the driver (`sacn_douser.DRIVER`), one stream for each
universe (`stream`), and the process that sends it (`sender`).
"""
