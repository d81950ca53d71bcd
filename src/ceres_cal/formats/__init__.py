"""The languages of others: one module for each format that a calibration can be exported to, and the table of them."""

from ceres_cal.formats.export_format import Exported as Exported
from ceres_cal.formats.export_format import ExportFormat as ExportFormat
from ceres_cal.formats.export_format import ExportRequest as ExportRequest
from ceres_cal.formats.export_format import Loss as Loss
from ceres_cal.formats.lookup import LookupTable as LookupTable
from ceres_cal.formats.lookup import make_lookup_table as make_lookup_table
from ceres_cal.formats.registry import EXPORT_FORMATS as EXPORT_FORMATS
from ceres_cal.formats.registry import export as export
from ceres_cal.formats.registry import export_format as export_format
from ceres_cal.formats.registry import prepare_export as prepare_export
