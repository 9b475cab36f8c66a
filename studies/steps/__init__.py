"""The steps of a study, thin as `stages/`: worlds, then for each case observe, solve and score, then conclude."""
