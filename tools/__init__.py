"""What makes committed files, and what sets a checkout up."""
