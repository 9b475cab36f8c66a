"""Studies: what each varies, what it measures, what the paper says, and what a full run tests."""
