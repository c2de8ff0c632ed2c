"""Write report.html: a diagnosis in one file that needs no network."""
