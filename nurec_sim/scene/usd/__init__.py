"""The USD layers of an archive, and checks of binary layers before OpenUSD reads them."""
