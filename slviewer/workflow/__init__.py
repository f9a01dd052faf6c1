"""What the operator does, without a face: every function here is a command of the command line."""
