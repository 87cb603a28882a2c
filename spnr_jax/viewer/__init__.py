"""`spnr view`: the network's picture of a cloud in the browser, turned, lit and saved there."""
