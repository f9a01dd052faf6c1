"""What becomes of registered scans: points fused by their sigma, cleaned, meshed, thinned,
smoothed."""
