"""Steps of the study of hard cases."""
