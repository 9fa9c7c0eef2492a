"""Files of public sets, as their authors published them."""
