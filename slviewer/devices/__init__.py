"""Cameras and projectors: two small protocols and one file for each driver; simulated rigs and
replay are drivers too.

`protocols` defines what a device does, `capture` shows a pattern sequence and grabs its frames,
`drivers` finds drivers by name. A device belongs to one thread. Adding a driver is adding a file to
this folder.
"""
