"""Clusters of tags: shapes to fold, their page to print, and measuring where the tags of a built one are."""
