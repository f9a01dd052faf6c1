"""What operations find, once: the schema on disk, the JSON, the value in Python, and what every
view draws."""
