"""Files in the forms that their specifications allow and their users write, drawn at random.

Each is written byte by byte, or with a library other than the one that reads it.
"""
