"""Detection of a changed arm, tool or camera, and identification of the part that changed."""
