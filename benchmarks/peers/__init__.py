"""Comparison of our learners with others on one page: same arms, same pairs, same split."""
