"""Several screens and computers as one display: a conductor agrees with their players on what is shown when.

``conductor`` is a process that serves the player's protocol in the place of a player; ``agent`` runs on each other
computer; ``screen`` is one player of the computer that it runs on.
"""
