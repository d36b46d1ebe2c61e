"""Images: reading and writing image files, error metrics, and contact sheets."""
