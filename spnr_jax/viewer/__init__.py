"""`spnr view`: a cloud's points and the network's picture of it side by side in the browser, edited live."""
