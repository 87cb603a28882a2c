"""What several tests share: laws, plain-loop references, small models, clouds, data sets and runs."""
