"""Steps of the study of the reflection operators."""
