"""Trained policies as files, and the ones that come with this package."""
