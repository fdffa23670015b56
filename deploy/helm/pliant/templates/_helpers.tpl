{{- define "pliant.labels" -}}
app.kubernetes.io/name: pliant
app.kubernetes.io/instance: {{ .Release.Name }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end }}

{{- define "pliant.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end }}

{{- define "pliant.redisSecret" -}}
{{- if .Values.redis.existingSecret }}{{ .Values.redis.existingSecret }}{{ else if .Values.valkey.enabled }}{{ .Release.Name }}-redis{{ else }}{{ fail "redis.existingSecret names the Secret with the URL, where valkey.enabled is false" }}{{ end }}
{{- end }}

{{- define "pliant.tokenSecret" -}}
{{ .Values.firstToken.existingSecret | default (printf "%s-token" .Release.Name) }}
{{- end }}

{{- define "pliant.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
fsGroupChangePolicy: OnRootMismatch
seccompProfile: {type: RuntimeDefault}
{{- end }}

{{- define "pliant.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end }}

{{- define "pliant.env" -}}
- name: PLIANT_DATA
  value: /data
- name: PLIANT_REDIS_URL
  valueFrom:
    secretKeyRef: {name: {{ include "pliant.redisSecret" . }}, key: url}
- name: PLIANT_BLOB_URL
{{- if eq .Values.storage.type "s3" }}
  value: {{ required "storage.s3.url is s3://bucket/prefix" .Values.storage.s3.url | quote }}
{{- with .Values.storage.s3.region }}
- name: AWS_REGION
  value: {{ . | quote }}
{{- end }}
{{- with .Values.storage.s3.endpoint }}
- name: AWS_ENDPOINT_URL
  value: {{ . | quote }}
{{- if hasPrefix "http://" . }}
- name: AWS_ALLOW_HTTP
  value: "true"
{{- end }}
{{- end }}
{{- else }}
  value: file:///data/shared/blobs
{{- end }}
{{- $own := list "DATA" "REDIS_URL" "BLOB_URL" "HOST" "PORT" "AUTH" "PARSERS" "READ_MEMORY" "ALLOWED_HOSTS" "THREADS" "MEMORY_LIMIT" "STOP_GRACE" }}
{{- range $name, $value := merge (dict) .Values.settings (dict "PLIANT_LOG_FORMAT" "json") }}
{{- if has (trimPrefix "PLIANT_" $name) $own }}
{{- fail (printf "settings.%s: the chart sets this variable itself; values.yaml names the value for it, if there is one" $name) }}
{{- end }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end }}

{{- define "pliant.envFrom" -}}
{{- if and (eq .Values.storage.type "s3") .Values.storage.s3.existingSecret }}
envFrom:
  - secretRef: {name: {{ .Values.storage.s3.existingSecret }}}
{{- end }}
{{- end }}

{{- define "pliant.mounts" -}}
- {name: scratch, mountPath: /data}
- {name: tmp, mountPath: /tmp}
{{- if eq .Values.storage.type "pvc" }}
- {name: shared, mountPath: /data/shared}
# Uploads are in PLIANT_DATA/uploads: any API process continues them, and the reconciler removes expired ones.
- {name: shared, mountPath: /data/uploads, subPath: uploads}
{{- end }}
{{- end }}

{{- define "pliant.volumes" -}}
- name: tmp
  emptyDir: {}
{{- if eq .Values.storage.type "pvc" }}
- name: shared
  persistentVolumeClaim: {claimName: {{ .Values.storage.pvc.existingClaim | default (printf "%s-data" .Release.Name) }}}
{{- end }}
{{- end }}

{{- define "pliant.scheduling" -}}
{{- with .Values.imagePullSecrets }}
imagePullSecrets: {{ toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.nodeSelector }}
nodeSelector: {{ toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.tolerations }}
tolerations: {{ toYaml . | nindent 2 }}
{{- end }}
{{- with .Values.affinity }}
affinity: {{ toYaml . | nindent 2 }}
{{- end }}
{{- end }}
