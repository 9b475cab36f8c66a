"""Cases are photos of data/eames: photos and whole once, then for each case solve and score, then conclude."""
