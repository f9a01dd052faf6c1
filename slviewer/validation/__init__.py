"""The program judged by simulated rigs with known truth, and by the clock. Only the command line
imports this."""
