"""The command line, without the commands: output (`console`), running a service (`running`), and `velatura
serve` (`serve_command`).
"""
