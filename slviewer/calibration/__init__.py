"""From board poses to models: stereo (pinhole and Brown), and pixelwise (the Letter)."""
