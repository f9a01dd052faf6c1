"""Pairwise ICP and merging of scans taken at different depths."""
