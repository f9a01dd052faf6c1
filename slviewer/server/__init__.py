"""Serving the wizard's page to the operator and to nobody else.

viser draws the page and carries its messages; this package decides who may open it, what a browser
may send back, which files may be fetched and which further pages (the projector's) stand beside it
on the same port.
"""
