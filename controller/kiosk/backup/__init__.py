"""A backup every night, to each place that stage.toml names: `places` a folder or a USB stick, `ssh` a server. Start at
`nightly`.
"""
