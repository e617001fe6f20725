"""All that nerfstudio loads: methods, dataparser, dataset, DataManager, model, viewer. Holds no formulas."""
