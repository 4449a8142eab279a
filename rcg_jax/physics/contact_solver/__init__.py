"""Contacts and joint limits for MJX, solved with the batch as the innermost axis."""
