"""The panel's words in the language of its visitor: `language` chooses and translates, `figures` writes numbers and
dates, `spoken` lists what the kiosk says. One catalogue (.po, compiled .mo) for each language.
"""
