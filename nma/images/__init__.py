"""Pictures: reading and writing them, metrics, contact sheets."""
