"""Suggest the next board poses: predicted uncertainty from the information that candidate poses
would add."""
