"""Steps of the study of what a solve costs.  What is measured is no function of the inputs: a result is kept until its sources change."""
