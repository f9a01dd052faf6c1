"""Plugins for slviewer, one a file."""
