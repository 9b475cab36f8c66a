"""Cases are made bodies of some materials in some lights: worlds, then for each case observe, solve and score, then conclude."""
