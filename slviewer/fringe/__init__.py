"""What is projected, and what it says: pattern sequences, phase shift, Gray code, decoding."""
