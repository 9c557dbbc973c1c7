"""How far do raters agree, with one another and with the released operation labels?"""
