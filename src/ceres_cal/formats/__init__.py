"""The languages of others: one module for each format that a calibration can be exported to, and the table of them."""

from ceres_cal.formats.format import Exported as Exported
from ceres_cal.formats.format import ExportFormat as ExportFormat
from ceres_cal.formats.format import ExportLoss as ExportLoss
from ceres_cal.formats.format import ExportRequest as ExportRequest
from ceres_cal.formats.format import ImportFormat as ImportFormat
from ceres_cal.formats.lookup import LookupTable as LookupTable
from ceres_cal.formats.lookup import make_lookup_table as make_lookup_table
from ceres_cal.formats.loss import loss_words as loss_words
from ceres_cal.formats.registry import EXPORT_FORMATS as EXPORT_FORMATS
from ceres_cal.formats.registry import IMPORT_FORMATS as IMPORT_FORMATS
from ceres_cal.formats.registry import export as export
from ceres_cal.formats.registry import export_format as export_format
from ceres_cal.formats.registry import import_calibration as import_calibration
from ceres_cal.formats.registry import import_observations as import_observations
from ceres_cal.formats.registry import prepare_export as prepare_export
from ceres_cal.formats.registry import read_foreign as read_foreign
from ceres_cal.formats.ssl_multicast import Group as Group
from ceres_cal.formats.ssl_multicast import Heard as Heard
from ceres_cal.formats.ssl_multicast import geometry_content as geometry_content
from ceres_cal.formats.ssl_multicast import publish as publish
from ceres_cal.formats.ssl_multicast import read_ssl_target as read_ssl_target
from ceres_cal.formats.ssl_multicast import received_geometry as received_geometry
from ceres_cal.formats.ssl_multicast import ssl_packet as ssl_packet
