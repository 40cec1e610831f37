"""The command line. Start at ``controller.__main__``, which lists the commands; ``commands`` has them.

``groups`` makes commands of functions, ``derived`` makes them of the kiosk's operations. ``console`` prints;
``error_reports`` shows why a command failed. ``kiosk_process`` runs a kiosk. ``plain_install`` answers where only the
player is installed.
"""
