"""What studies share: cases, the worlds they show, observations, scores, statistics."""
