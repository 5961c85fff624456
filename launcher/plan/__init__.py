"""`tenuto plan`: how long to update and how long to hold, by the bound of the paper's section 5."""
