"""Cases are methods that see the same photos: worlds, then for each case observe, solve or optimise, and score, then conclude."""
