"""Our learners beside those of others: same arms, same pairs, same split, one page."""
