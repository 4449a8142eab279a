"""The race: minutes to a solved task, of this package and of what a user would run instead."""
