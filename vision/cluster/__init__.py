"""Clusters of tags: shapes to fold, their page to print, and measurement of the tags' poses on a built one."""
