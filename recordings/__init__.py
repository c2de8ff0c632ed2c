"""Pairs on disk: CSV, Parquet, MCAP, ROS bags, Rerun, and the store."""
