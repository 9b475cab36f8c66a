"""What the data can and cannot say about an answer: standard errors (`uncertainty`), what is open, in sentences (`identifiability`)."""
