"""A rig, scenes and a renderer with ground truth; its lens code is its own."""
